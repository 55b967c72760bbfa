"""Find out whether the input is wrong, by tests on the log, on the residuals of a solution, and on changed copies.

Nothing here changes a map. The checks say in words what is wrong, and whether the positions are reliable.
"""
