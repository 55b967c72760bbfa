"""Joint mode: rounds of association and solve that move the objects and the poses of a log together.

`mapping/joint_solve` chooses where the rounds begin. Moves that change many objects at once are in `mapping/moves`.
"""
