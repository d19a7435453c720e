"""The figures of docs/reliability.md, each measured against a server process of its own: `python -m tests.reliability --help`."""
