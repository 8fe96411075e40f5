"""Tasks by name: `make_task("box_pick_and_place", make_morphology("g1"))`.

The tasks themselves register when `xop_lerobot.tasks.stage` or `make_task` is first used.
"""
