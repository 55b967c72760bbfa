"""The stages of one run, in their order: input, measurements, solve, complete map, and result.

`mapping/pipeline.py` calls them one after the other. What a stage does with a map is in the other folders of `mapping`.
"""
