"""Choose settings, and use the shared errors of one drive for the next: settings_and_calibration.py LOG OUT."""

import sys
from pathlib import Path

import objslam


def main(source: str, out: str) -> objslam.Result:
    """Map a log in joint mode, print the errors that all its measurements share, and map it again with them as a prior."""
    log = objslam.read(source)
    # The name of ready settings or a YAML file, and changes on top. A key may be dotted: settings={"rays.pixel_sigma": 2}.
    first = objslam.run(log, "odometry", rays={"pixel_sigma": 2.0}, output={"recording": False})
    for name, error in first.summary["calibration"]["parameters"].items():
        print(f"{name}: {error['value']:.4f} +- {error['sigma']:.4f} {error['unit']}")
    first.save(out)
    known = {"file": str(Path(out) / "summary.json")}
    second = objslam.run(log, "odometry", calibration=known)
    print(second.objects)
    return second


if __name__ == "__main__":
    if len(sys.argv) != 3:
        raise SystemExit(__doc__)
    try:
        main(*sys.argv[1:])
    except objslam.ObjslamError as error:  # One line: what, where, what to do.
        raise SystemExit(str(error)) from None
