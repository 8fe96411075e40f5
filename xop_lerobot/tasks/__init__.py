"""Tasks by name: `make_task("box_pick_and_place", make_morphology("g1"))`.

Task modules are imported when first used.
"""
