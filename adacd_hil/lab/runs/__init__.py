"""Many runs: what each came to, found again, and how it went on from run to run."""
