"""The `microid` command as `python -m microid`."""

from importlib.metadata import entry_points

if __name__ == "__main__":
    # By its name: what a stage is imports nothing of what data teach.
    (command,) = entry_points(group="console_scripts", name="microid")
    command.load()()
