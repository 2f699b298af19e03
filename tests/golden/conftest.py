"""The files of the recorder hold no tests, and import one another by name, as a script's neighbours do."""

collect_ignore = ["adapter.py", "cases.py", "inputs.py", "record.py"]
