"""The library's packages in the order in which data flow; each imports only itself and what stands before it."""

PACKAGES = ["core", "cloud", "photos", "marks", "geometry", "sfm", "georef", "mvs", "masks", "nerf", "crop"]
PACKAGES += ["register", "fuse", "surface", "metrics", "report", "paper", "pick", "two_clouds"]
