"""The factor graph: the only room that knows GTSAM."""
