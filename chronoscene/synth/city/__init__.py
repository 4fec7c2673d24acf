"""The generated city: settings go in, a `World` comes out.

`plan` lays out the blocks, `blocks` fills them, and the other modules build what stands there.
"""
