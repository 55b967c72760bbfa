"""Map a log folder or a ROS bag, and write a result folder: python examples/map_folder.py LOG OUT."""

import sys

import objslam


def main(source: str, out: str) -> None:
    """Read, map, print and save."""
    log = objslam.read(source)
    print(log)
    result = objslam.run(log)
    print(result.objects)
    for warning in result.warnings:
        print("warning:", warning)
    result.save(out)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        raise SystemExit(__doc__)
    try:
        main(*sys.argv[1:])
    except objslam.ObjslamError as error:  # One line: what, where, what to do.
        raise SystemExit(str(error)) from None
