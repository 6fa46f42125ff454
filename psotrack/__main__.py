"""`python -m psotrack` is `psotrack`."""

from psotrack.cli import main

if __name__ == "__main__":
    main()
