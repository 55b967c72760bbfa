"""Find the most likely path of a robot through a map of landmarks, when each ray may belong to any landmark. The search can
move a whole visit of the robot from landmarks to their neighbours. Small changes cannot."""
