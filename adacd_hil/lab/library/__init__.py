"""Library for other programs: a log as arrays, arrays through the scheme. `adacd_hil.api` names its public parts."""
