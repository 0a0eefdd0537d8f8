"""The `microid` command as `python -m fits`."""

from fits.cli._main import main

if __name__ == "__main__":
    main()
