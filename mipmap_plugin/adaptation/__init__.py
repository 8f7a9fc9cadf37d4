"""Adapting a frozen base to another scale.

`FrozenBase.adapt` makes a `request`. For it `conversion` runs one `session`, or two. A session chooses `views` and makes their truth (`target`),
searches a `start`, runs Algorithm 1 from there (`optimization.loop`), and returns the best of the states with its `report`, as `adapted`.
"""
