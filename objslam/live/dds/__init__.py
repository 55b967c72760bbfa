"""Network, message types and map publication for DDS, the transport of ROS 2. The adapter is `live.adapters.dds`."""
