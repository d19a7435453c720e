"""Hours of mixed work against one server: does its memory stay, and do its counters add up?"""
