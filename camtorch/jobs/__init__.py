"""Many files at once: what to read, by which processes, what is done already, and what went wrong.

`inputs.find` says which files are meant, `items` what is made of each; `run.run` has it made, and a `Manifest` keeps
account.
"""
