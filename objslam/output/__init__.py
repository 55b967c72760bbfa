"""The outputs of a run: the result folder, the picture map.png, the rerun recording, the report and the exports.

No map is computed here. The code that reads a result folder is in `results`.
"""
