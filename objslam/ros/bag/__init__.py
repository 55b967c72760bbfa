"""Read ROS 1 bags, sqlite3 bags and MCAP files, whole or damaged, as serialised messages with topic and timestamp.

The decoding of the messages is in `ros.messages`.
"""
