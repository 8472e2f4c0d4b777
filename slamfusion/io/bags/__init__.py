"""Scans of ROS 1 and ROS 2 bags, without ROS; needs ``rosbags`` (the extra ``bags``)."""

METADATA = "metadata.yaml"
# Patterns of a bag's storage files in a folder; a bag has one kind.
STORAGE_FILES = ("*.mcap", "*.db3", "*.mcap.zstd", "*.db3.zstd")
# First bytes of storage files and of packed ones.
ROS1_MAGIC, SQLITE_MAGIC, MCAP_MAGIC = b"#ROSBAG V", b"SQLite format 3\0", b"\x89MCAP0\r\n"
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
