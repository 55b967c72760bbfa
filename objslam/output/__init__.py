"""The outputs of a run: the result folder, the picture map.png, the rerun recording, the report and the exports.

This folder computes no map, and the code that reads a result folder is in `results`.
"""
