"""Changes to a solved map that rounds of association and solve do not find, and the reasons to look for them.

Visits whose landmarks are copies of older ones are moved onto them. Objects where rays of several things meet, because the
poses err, are dropped. So are objects of things that move. The odometry shows whether the poses err.
"""
