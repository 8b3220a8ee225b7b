"""The emulated arm's mechanics, and the settings of its parts."""
