"""Files that go into the asset as they are.

They import nothing of this project: whoever has the asset and Mitsuba can run them.
"""
