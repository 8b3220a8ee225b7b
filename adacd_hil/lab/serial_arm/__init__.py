"""A serial arm with n joints on recorded arrays: geometry from a URDF, dynamics, identification and detection."""
