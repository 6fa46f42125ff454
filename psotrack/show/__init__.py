"""What people look at: a window, videos and pages of a flight, a sweep or a calibration.

In: files of tracks with their records, a recording, results. Out: `flights` makes one `TrackedFlight` of them, which
the three others show: `viewer` in Rerun, `overlay` in videos, and `reports` on pages.
"""
