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
