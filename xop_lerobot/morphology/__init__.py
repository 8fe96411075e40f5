"""What a robot is to the retargeter: models, command space, frames, contacts, parameters."""
