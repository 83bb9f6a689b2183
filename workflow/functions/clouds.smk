# Clouds that the tables name in the place of photos.


def one_of(names):
    """A wildcard's constraint: one of some names; with none, nothing matches."""
    return "|".join(map(re.escape, names)) or "(?!)"


def cloud_of(kind):
    """Input function: the cloud of a scene or an object."""
    return lambda wildcards: own_file(kind, wildcards[kind], "cloud")


def cloud_path(kind):
    """The same, for a command line."""
    return lambda wildcards: shlex.quote(*cloud_of(kind)(wildcards))


def with_cameras(path):
    """Input function: a file of a scene's given cameras; none where photos were laid on the scene's cloud."""
    return lambda wildcards: (
        [] if lies_on_cloud(wildcards) else path.format(scene=wildcards.scene)
    )
