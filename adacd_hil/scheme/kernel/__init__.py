"""The compiled numbers of one cycle, of both schemes, and of many cycles at once."""
