"""What is simulated and refitted: the model with every candidate attached, its noise, its readings."""
