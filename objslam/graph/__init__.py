"""The factor graph, batch and incremental: variables, factors, optimisers, marginals. The only room that knows GTSAM.

What a log is, and the alternation of association and solve, are not here: that is in `mapping`.
"""
