"""The foreground of videos: where something that moves stands before what stands still, as pixels or as boxes.

In: videos. Out: `silhouettes`, the share of each reduced pixel that is foreground, and the blobs in them; `detection`,
the boxes of a neural network. Both are computed once per video and stored. `markers` finds ArUco markers in one image.
"""
