"""What a run came to: contacts, alarms, margins, verdict; the one judge of whether a contact was found, and when."""
