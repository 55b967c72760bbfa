"""Train the SSD that comes with the package on rendered images, and export it to objslam/detection/models/ssd7.onnx.

python tools/train_detector.py render --out DATA            # write images (resumable)
python tools/train_detector.py train --data DATA --out RUN  # write checkpoints and a log with mAP (resumable)
python tools/train_detector.py export --run RUN --data DATA --onnx objslam/detection/models/ssd7.onnx
python tools/train_detector.py measure --data DATA          # measure a model on the held-out images of `render`
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from ssd.data import RAW_SCALE, SIZE, load_samples, render_samples
from ssd.evaluate import measure
from ssd.model import Ssd
from ssd.train import train

from objslam.simulation.shapes import LABELS


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    render = commands.add_parser("render", help="render training and held-out images")
    render.add_argument("--out", type=Path, required=True)
    render.add_argument("--train", type=int, default=1920)
    render.add_argument("--held-out", type=int, default=400)
    render.add_argument("--seed", type=int, default=7)
    training = commands.add_parser("train", help="train from the start, or from the last checkpoint if there is one")
    training.add_argument("--data", type=Path, required=True)
    training.add_argument("--out", type=Path, required=True)
    training.add_argument("--steps", type=int, default=1600)
    training.add_argument("--seed", type=int, default=7)
    training.add_argument("--threads", type=int, default=1)
    exporting = commands.add_parser("export", help="write the ONNX model, check it against torch, and measure it")
    exporting.add_argument("--data", type=Path, required=True)
    exporting.add_argument("--run", type=Path, required=True)
    exporting.add_argument("--onnx", type=Path, default=Path("objslam/detection/models/ssd7.onnx"))
    measuring = commands.add_parser("measure", help="measure an ONNX model on the held-out images")
    measuring.add_argument("--data", type=Path, required=True)
    measuring.add_argument("--onnx", type=Path, default=Path("objslam/detection/models/ssd7.onnx"))
    arguments = parser.parse_args()
    if arguments.command == "render":
        render_samples(arguments.out, "held_out", arguments.held_out, arguments.seed)
        render_samples(arguments.out, "train", arguments.train, arguments.seed)
    elif arguments.command == "train":
        torch.set_num_threads(arguments.threads)
        train(arguments.data, arguments.out, arguments.steps, arguments.seed)
    elif arguments.command == "export":
        export_and_check(arguments.data, arguments.run, arguments.onnx)
        print_quality(arguments.data, arguments.onnx)
    else:
        print_quality(arguments.data, arguments.onnx)


def export_and_check(data: Path, run: Path, file: Path) -> None:
    """Export the last checkpoint, and check that onnxruntime agrees with torch."""
    from ssd.export import export, parity

    state = torch.load(run / "checkpoint.pt", weights_only=True)
    network = Ssd(len(LABELS), SIZE)
    network.load_state_dict(state["network"])
    export(network, LABELS, file, {"author": "objslam", "description": "SSD for the seven objects of rendered drives"})
    held_out = load_samples(data, "held_out")
    box, score = parity(network, file, held_out.images[:64])
    print(f"{file}: {file.stat().st_size / 1e6:.2f} MB after {state['step']} steps; against torch {box:.1e} px, {score:.1e}")


def print_quality(data: Path, file: Path) -> None:
    """Print how well a model finds the objects of the held-out images."""
    from ssd.export import run_onnx

    held_out = load_samples(data, "held_out")
    quality = measure(run_onnx(file, held_out.images), held_out, len(LABELS), RAW_SCALE)
    print(f"{len(held_out)} held-out images, {int(held_out.counts.sum())} objects: mAP@0.5 {quality.mean:.4f}")
    for label, precision in zip(LABELS, quality.precision, strict=True):
        print(f"  {label:18} {precision:.4f}")
    middle = np.percentile(quality.errors, [50, 90])
    print(f"at score 0.5: recall {quality.recall:.3f}, false {quality.false:.3f}, middles off by {middle} px (median, 90 %)")


if __name__ == "__main__":
    main()
