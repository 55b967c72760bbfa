"""A result held against the truth: the two maps laid on each other, matched, and the errors as numbers and a table.

Where results come from is `results`; pictures of them are in `output`.
"""
