"""The checks of types at run time, which `make nightly` asks for."""

from beartype import BeartypeConf, beartype

#: Whole numbers are floats, as for mypy (PEP 484).
checked = beartype(conf=BeartypeConf(is_pep484_tower=True))
