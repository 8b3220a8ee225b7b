"""What is done with an arm before a run: tare, test of the connection, diagnosis. The drives carry no torque."""
