"""The command `objslam register`, which finds the transform between the frames of two maps."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from objslam.cli.console import say


def register_results(
    a: Annotated[Path, typer.Argument(metavar="A", help="A result folder, or an objects.json.")],
    b: Annotated[Path, typer.Argument(metavar="B", help="The other map.")],
) -> None:
    """Find the transform from map A to map B by the relative positions of their objects. Exit code 1: it is not certain."""
    import numpy as np

    from objslam.association.registration.object_maps import reason, register
    from objslam.results.object_map import ObjectMap

    one, other = ObjectMap.load(a), ObjectMap.load(b)
    found = register(one, other)
    if np.isfinite(found.b_T_a).all():
        x, y, z = found.b_T_a[:3, 3]
        yaw = np.degrees(np.arctan2(found.b_T_a[1, 0], found.b_T_a[0, 0]))
        sigma = np.sqrt(np.diag(found.covariance)) * [1, 1, 1, np.degrees(1)]
        say(f"B_T_A: x {x:.3f} y {y:.3f} z {z:.3f} m, yaw {yaw:.2f} deg")
        say("sigma: x {:.3f} y {:.3f} z {:.3f} m, yaw {:.2f} deg".format(*sigma))
    for i, k in found.matches.tolist():
        say(f"  {one[i].label} #{one[i].id} is #{other[k].id}")
    why = reason(found, one, other, (str(a), str(b)))
    say(f"registered: {why}" if found.accepted else f"not registered: {why}")
    if not found.accepted:
        raise typer.Exit(1)
