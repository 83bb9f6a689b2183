# Clouds that the tables name in the place of photos.
from scenefuse.cloud.formats import with_named


def one_of(names):
    """A wildcard's constraint: one of some names; with none, nothing matches."""
    return "|".join(map(re.escape, names)) or "(?!)"


def cloud_of(kind):
    """Input function: the cloud of a scene or an object."""
    return lambda wildcards: own_file(kind, wildcards[kind], "cloud")


def cloud_files(kind):
    """The same with the files that a mesh names, some of which may be missing: to know its state."""
    return lambda wildcards: [
        str(file)
        for path in cloud_of(kind)(wildcards)
        for file in with_named(Path(path))
    ]


def cloud_path(kind):
    """The cloud itself, for a command line."""
    return lambda wildcards: shlex.quote(*cloud_of(kind)(wildcards))


def with_cameras(path):
    """Input function: a file of a scene's given cameras; none where photos were laid on the scene's cloud."""
    return lambda wildcards: (
        [] if lies_on_cloud(wildcards) else path.format(scene=wildcards.scene)
    )
