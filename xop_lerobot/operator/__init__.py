"""The person in the headset: frames, alignment, gestures and devices."""
