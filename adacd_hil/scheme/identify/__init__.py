"""Learning of an arm's model, and the checks of the learnt model."""
