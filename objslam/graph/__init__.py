"""The factor graph, batch and incremental: variables, factors, optimisers and marginals, the only folder that knows GTSAM.

The alternation of association and solve is in `mapping`.
"""
