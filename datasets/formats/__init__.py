"""One loader per file format, from bytes to columns of numbers; what the numbers mean is stated in log.yaml.

`recording` is the interface of a loader and the registry. `imc` and `ardupilot` read files of messages. `topics` is
what ROS bags (`ros_bag`, which has `ros1_bag` and `ros2_database`; `ros_messages`) and MCAP files (`mcap_file`) have in
common. `unpacking` bounds what is packed in a file. `columns` reads tables: text, Parquet or NumPy arrays.
"""
