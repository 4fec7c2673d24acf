"""A scene folder as it is on disk, however damaged: `scene_folder.RawScene` and what it reads."""
