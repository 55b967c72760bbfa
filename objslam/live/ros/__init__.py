"""ROS messages of a running robot: the choice of topics, and the pushes that each message causes.

The adapters that receive messages are in `live.adapters`, and the meaning of each message type is in `ros`.
"""
