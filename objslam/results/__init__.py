"""A result folder as others see it: the names of its files, and what is read back from them.

What writes the files is `output`, for it draws and records as well.
"""
