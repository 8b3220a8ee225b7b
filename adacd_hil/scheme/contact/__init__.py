"""What is known of a contact: link, direction, size, place, and the reaction to it."""
