"""CANopen's identifiers in a contract: base identifiers, node ids, the host's heartbeat. Source: CiA 301."""

NODE_MASK, FUNCTION_MASK = 0x7F, 0x780
HOST_HEARTBEAT = "HostHeartbeat"
NMT_ID, SYNC_ID, EMERGENCY_ID, HEARTBEAT_ID = 0x000, 0x080, 0x080, 0x700
TPDO_IDS, RPDO_IDS = (0x180, 0x280, 0x380, 0x480), (0x200, 0x300, 0x400, 0x500)
SDO_RESPONSE_ID, SDO_REQUEST_ID = 0x580, 0x600
"""Base identifiers of the predefined connection set; a node adds its id to all but the first two."""
SYNC_OVERFLOW = 240
"""0x1019: the SYNC counter runs 1…240, as long as CiA 301 lets it."""
NOT_VALID = 1 << 31
"""Bit 31 of a COB-ID, CiA 301 clause 7.5.2.35: the PDO or EMCY is switched off."""
