"""A rig from nothing: lenses and places of several cameras, from views of a board that is moved before them.

In: images or videos of all cameras (`images`). Out: a `CalibratedRig` with covariances. `views` finds the corners of
the board, `lenses` finds a first lens of each camera, `chain` joins the cameras through the views that they share,
`adjustment` adjusts lenses, cameras and boards together and says how certain the rig is, and `findings` says what to
do. Without a board, `moving_point` places the cameras. `shifts` names cameras whose frames are counted wrongly.
"""
