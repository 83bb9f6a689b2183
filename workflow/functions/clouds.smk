# Clouds that the tables name in the place of photos.


def one_of(names):
    """A wildcard's constraint: one of some names; with none, nothing matches."""
    return "|".join(map(re.escape, names)) or "(?!)"


def cloud_of(row, kind):
    """Input function: the cloud of a scene or an object."""

    def files(wildcards):
        name = wildcards[kind]
        path = row(name)["cloud"]
        if not (made_here(path) or Path(path).is_file()):
            raise WorkflowError(
                f"{config[f'{kind}s']}, {kind} '{name}': the cloud {path} does not exist"
                f" (relative paths begin at {os.getcwd()})"
            )
        return [path]

    return files


def cloud_path(row, kind):
    """The same, for a command line."""
    return lambda wildcards: shlex.quote(row(wildcards[kind])["cloud"])
