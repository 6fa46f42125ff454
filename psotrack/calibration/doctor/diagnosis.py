"""What the doctor found: findings, and what was measured of each camera, as records, tables and JSON."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from psotrack.calibration.doctor.findings import Finding
from psotrack.support import finite_or_none, html_block, html_table, text_table

_HEADINGS = ("camera", "detections/frame", "explained", "median (px)", "(noise)", "late (ms)")
_SOUND = "nothing disagrees"


@dataclass(frozen=True)
class Diagnosis:
    """Result of an examination; its text is what `psotrack doctor` prints.

    Attributes:
        cameras: names of the cameras.
        fps: frames per second of the videos.
        findings: disagreements; empty for a correct rig.
        num_frames: number of examined frames.
        num_sightings: (cameras,), numbers of sightings in these frames.
        num_explained: (cameras,), numbers of sightings that agree with those of other cameras, after a wrong unit or
            interpretation of the rig was corrected.
        residual_px: (cameras,), median distance of the camera's sightings from where the other cameras put the bodies,
            pixels; NaN if too few agree.
        residual_std: (cameras,), the same in units of the noise that boxes are first assumed to have.
        late_frames: (cameras,), how late each camera's video shows the scene, relative to the median camera, frames:
            frame i of a video that is late by k shows what the others show in frame i - k; NaN if it cannot be found.
        late_std_frames: (cameras,), standard deviations of `late_frames`.
        epipolar_px: (cameras, cameras), median distances of sightings from each other's epipolar lines, pixels; NaN for
            pairs of cameras without common points.
        reference_m: median distance of the points from the reference, metres; NaN without one.
    """

    cameras: tuple[str, ...]
    fps: float
    findings: tuple[Finding, ...]
    num_frames: int
    num_sightings: Int[np.ndarray, "cameras"]
    num_explained: Int[np.ndarray, "cameras"]
    residual_px: Float[np.ndarray, "cameras"]
    residual_std: Float[np.ndarray, "cameras"]
    late_frames: Float[np.ndarray, "cameras"]
    late_std_frames: Float[np.ndarray, "cameras"]
    epipolar_px: Float[np.ndarray, "cameras cameras"]
    reference_m: float

    def to_dict(self) -> dict[str, Any]:
        """The findings and measurements, with None for missing numbers."""
        return {
            "findings": [
                {
                    **vars(finding),
                    "cameras": list(finding.cameras),
                    "nearly_as_likely": list(finding.nearly_as_likely),
                }
                for finding in self.findings
            ],
            "frames": self.num_frames,
            "explained": float(self.num_explained.sum() / max(self.num_sightings.sum(), 1)),
            "cameras": self._measured(),
            "epipolar_px": [[finite_or_none(value) for value in row] for row in self.epipolar_px],
            "reference_m": finite_or_none(self.reference_m),
        }

    def __str__(self) -> str:
        """Tables of the cameras and of their pairs, and the findings."""
        pairs = (
            (name, *("" if np.isnan(value) else f"{value:.1f}" for value in values))
            for name, values in zip(self.cameras, self.epipolar_px, strict=True)
        )
        title = "median distance from epipolar lines (px)"
        tables = [text_table(_HEADINGS, self._rows()), text_table(("", *self.cameras), pairs, title)]
        return "\n".join([*tables, *(map(str, self.findings) if self.findings else [_SOUND])])

    def __repr__(self) -> str:
        return f"Diagnosis({'; '.join(map(str, self.findings)) or _SOUND})"

    def _repr_html_(self) -> str:
        """What a notebook shows: the findings, and the table of the cameras."""
        return html_block("; ".join(map(str, self.findings)) or _SOUND, html_table(_HEADINGS, self._rows()))

    def _measured(self) -> list[dict[str, Any]]:
        """Measurements of each camera."""
        return [
            {
                "camera": name,
                "detections_per_frame": float(self.num_sightings[index] / max(self.num_frames, 1)),
                "explained": float(self.num_explained[index] / max(self.num_sightings[index], 1)),
                "residual_px": finite_or_none(self.residual_px[index]),
                "residual_std": finite_or_none(self.residual_std[index]),
                "late_frames": finite_or_none(self.late_frames[index]),
                "late_std_frames": finite_or_none(self.late_std_frames[index]),
            }
            for index, name in enumerate(self.cameras)
        ]

    def _rows(self) -> list[tuple[str, ...]]:
        """The same as texts of a table."""
        rows, to_ms = [], 1e3 / self.fps
        for row in self._measured():
            late, std = row["late_frames"], row["late_std_frames"]
            rows.append(
                (
                    row["camera"],
                    f"{row['detections_per_frame']:.2f}",
                    f"{row['explained']:.0%}",
                    *(
                        "" if row[key] is None else f"{row[key]:.1f}"
                        for key in ("residual_px", "residual_std")
                    ),
                    "" if late is None else f"{late * to_ms:+.0f} ± {std * to_ms:.0f}",
                )
            )
        return rows
