"""The command `objslam detect`, which tries a detector on one image."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from objslam.cli.console import put, say
from objslam.cli.options import ClassNames, Config, EncoderModel, Json, Set, settings_of


def detect(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="An ONNX detector.")],
    image: Annotated[Path, typer.Argument(metavar="IMAGE", help="A photo: PNG, JPEG, ...")],
    out: Annotated[Path | None, typer.Option("-o", "--out", help="PNG or JPEG file for the photo with boxes.")] = None,
    embed: EncoderModel = None,
    config: Config = None,
    set_: Set = None,
    names: ClassNames = None,
    json: Json = False,
) -> None:
    """Try a detector on one photo. Print how the model's outputs are read, and which boxes it finds. No log is needed."""
    from objslam.detection import load_detector, load_encoder
    from objslam.errors import ConfigError, LogError
    from objslam.io.atomic_files import write_file
    from objslam.io.images import decode_colour
    from objslam.io.results.files import dump_json
    from objslam.io.text import read_bytes
    from objslam.output.plot.boxes_plot import PICTURES, draw_boxes

    if out is not None and out.suffix.lower() not in PICTURES:
        raise ConfigError(
            "the photo with the boxes must be a PNG or JPEG file", where=str(out), hint=f"end it with {PICTURES[0]}"
        )
    settings = settings_of(None, config, set_, names=names)
    pixels = decode_colour(read_bytes(image))
    if pixels is None:
        raise LogError("this is no image, or it is too large", where=str(image))
    detector = load_detector(model, settings.detector)
    encoder = None if embed is None else load_encoder(embed, settings)
    (found,) = detector.detect([pixels])
    for warning in detector.warnings:
        say(f"warning: {warning}", stderr=True)
    if out is not None:
        write_file(out, draw_boxes(pixels, found.boxes, found.labels, found.scores, out.suffix.lower()))
    recipe, (height, width) = detector.recipe, pixels.shape[:2]
    rows = [
        {"box": box, "label": label, "score": score}
        for box, label, score in zip(found.boxes.tolist(), found.labels, found.scores.tolist(), strict=True)
    ]
    vectors = None if encoder is None or not rows else encoder.encode(pixels, found.boxes)
    if vectors is not None:
        rows = [{**row, "features": vector} for row, vector in zip(rows, vectors.tolist(), strict=True)]
    if json:
        put(dump_json({"layout": recipe.layout, "image": [width, height], "boxes": rows}))
        return
    units = recipe.box_units or "pixels or fractions, decided by their values"
    say(f"{model}: outputs in the {recipe.layout} layout, boxes as {recipe.box_form} in {units}, {recipe.resize}")
    say(f"{image}: {width}x{height}, {len(rows)} boxes with a score of {settings.detector.min_score:g} or more")
    for row in rows:
        x1, y1, x2, y2 = row["box"]
        say(f"  {row['label']} {row['score']:.2f}: x {x1:.0f} to {x2:.0f}, y {y1:.0f} to {y2:.0f} px")
    if vectors is not None:
        say(f"{embed}: an appearance vector of {vectors.shape[1]} numbers for each box")
    if not rows:
        say("nothing was found: try --set detector.min_score=0.1, or a photo of a thing that the model knows")
    if out is not None:
        say(f"wrote {out}")
