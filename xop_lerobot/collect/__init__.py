"""Many episodes in parallel, resumable: `xop-collect`, and the engine of `xop-curate retarget`."""
