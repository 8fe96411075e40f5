"""A simulated person in the headset: sees late and not quite, moves as people move, corrects."""
