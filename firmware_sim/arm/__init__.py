"""The emulated arm's mechanics, and what its parts are set to."""
