"""Generated from `proto/ada_diffuser/v1`: do not edit, see the README for the command."""
