"""One evaluation: methods x environments x training seeds, each collected, trained, served, rolled out and probed, and what came of it.

A `Suite` is a TOML file. A `Cell` is one method in one environment with one training seed; what it found is a small JSON file for each mode
(cold, streaming). `schedule` lets cells work two at a time, `work` is what each of them does, `report` makes pages of the files.
"""
