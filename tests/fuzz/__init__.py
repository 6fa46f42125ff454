"""Damaged files for every reader: `make fuzz`.

A try changes one file of one format of `formats` by `mutations`, and gives the file to a public function or to a
command. `trial` judges what happens: see its docstring for the property. `__main__` runs many tries in processes that
may be killed.
"""
