"""Files, one module a format: each reads or writes one kind of file and says what is wrong with it, by line.

What a folder of such files means is not decided here: logs are in `sources`, results in `results` and `output`.
"""
