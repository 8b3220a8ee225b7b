"""How much a report shows, whatever the length of the run: its size is bounded. The tables as CSV and JSON have all."""

from typing import Final

SECTIONS: Final = 60
"""Sections with a row in the tables of sections and margins."""
CONTACTS: Final = 200
"""Contacts with a row in the table of contacts, and so many more that went wrong."""
PRINTED_CONTACTS: Final = 40
"""The same for a terminal and on paper."""
ADAPTATIONS: Final = 8
"""Adaptations with a figure, and with columns in the tables of parameters."""
MARKS: Final = 1_500
"""Stays and contacts on the timeline, each; beyond, those that are narrower than a mark are drawn as one."""
