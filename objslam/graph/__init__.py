"""The factor graph, batch and incremental, with its variables, factors, optimisers and marginals.

Only this folder uses GTSAM. The alternation of association and solve is in `mapping`.
"""
