"""Tables of numbers: delimited text, Parquet, NumPy arrays."""
