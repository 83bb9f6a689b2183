"""The version of this library; a module of its own, so that a new one reruns only the steps that write it down."""

VERSION = "0.1.0"
