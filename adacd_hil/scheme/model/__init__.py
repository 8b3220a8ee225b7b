"""The arm's equations and the filters that free them of acceleration."""
