"""Objects, PDOs and services of an emulated node."""
