"""What holds for all tests."""

from hypothesis import HealthCheck, settings

settings.register_profile("objslam", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("objslam")  # no example is too slow: that depends on what else the machine does
