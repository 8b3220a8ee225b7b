"""CAN frames in files of any format."""
