"""Read a result folder and ask it questions: python examples/query_result.py OUT."""

import sys

import objslam


def main(folder: str) -> None:
    """Objects by place, tables for pyarrow and pandas, and the rays of one object."""
    result = objslam.Result.load(folder)
    print(result.poses)
    for one in result.objects:
        print(one.id, one.label, one.status, one.position)
    nearest = result.objects.nearest([0.0, 0.0])  # x, y, or x, y, z in m
    print("nearest to the origin:", nearest)
    table = result.rays.to_arrow()  # to_pandas() returns a data frame, if pandas is installed
    print(table.select(["stamp", "object", "residual"]).slice(0, 3).to_pylist())
    if nearest is not None:
        print("rays of it:", int((result.rays.object == nearest.id).sum()))
    print(result.objects.to_arrow().column_names)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        raise SystemExit(__doc__)
    try:
        main(*sys.argv[1:])
    except objslam.ObjslamError as error:  # One line: what, where, what to do.
        raise SystemExit(str(error)) from None
