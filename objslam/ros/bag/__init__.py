"""Read ROS 1 bags, sqlite3 bags and MCAP files, whole or damaged. `ros.messages` decodes their serialised messages."""
