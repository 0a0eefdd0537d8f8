"""The `microid` command as `python -m fits`."""

from fits._cli import main

if __name__ == "__main__":
    main()
