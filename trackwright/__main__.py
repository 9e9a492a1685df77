"""`python -m trackwright` is `trackwright`."""

from trackwright.experiments.cli.main import main

if __name__ == "__main__":
    main()
