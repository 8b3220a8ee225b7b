"""The score of a run: contacts, alarms, margins, verdict; the one judge of whether and when a contact was found."""
