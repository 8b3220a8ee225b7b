"""Contacts: link, direction, size and place of a contact, and the reaction to it."""
