"""What the fusion of an object writes, made by hand."""

import numpy as np

from scenefuse.cloud.clouds import write_cloud
from scenefuse.fuse.compare import Reason
from scenefuse.fuse.measure import unchecked
from scenefuse.fuse.write import Source, with_source


def write_changes(folder, scene, added, rows=(), removed=(), evidence=0):
    """fused.ply with the added points, and checked.ply with some rows of a scene, of which some are taken away."""
    rows = np.array(rows, dtype=np.int64)
    checked = unchecked(scene[rows])
    checked.fields["evidence"][:] = evidence
    checked.fields["row"] = rows.astype(np.uint32)
    checked.fields["reason"] = np.where(np.isin(rows, removed), Reason.REPLACED, Reason.KEPT).astype(np.uint8)
    write_cloud(folder / "checked.ply", checked)
    write_cloud(folder / "fused.ply", with_source(unchecked(added), Source.OBJECT))
