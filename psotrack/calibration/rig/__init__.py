"""Lenses and places of several cameras, from a board or points that they see.

In: images or videos of all cameras, or points in them. Out: a `RigCalibration`, with covariances of the cameras.
`views` finds the corners of the board, `start` a first lens of each camera and the cameras' places through the views
that they share, and `adjustment` adjusts lenses, cameras and boards together and says how certain the rig is.
`moving_point` does the same for a point that moves, and `point_files` reads points and what fixes the world. `shifts`
names cameras whose frames are counted wrongly, `calibrations` has the three ways as a whole, and `findings` says what
came out and what to do.
"""
