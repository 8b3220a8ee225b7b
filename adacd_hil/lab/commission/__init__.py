"""Work on an arm before a run: configuration draft, tare, communication test, diagnosis. The drives carry no torque."""
