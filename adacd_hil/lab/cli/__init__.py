"""Commands of the lab, a file each."""
