"""Find out whether the input is wrong: tests on the log, on the residuals of a solution, and of what-if changes to the log.

Nothing here changes a map. The checks say what is wrong in words, and whether positions can be relied on.
"""
