"""What other programs import: a log as arrays, arrays through the scheme. `adacd_hil.api` names all of it."""
