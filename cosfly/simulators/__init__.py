"""CARLA and Unreal as they are met from outside: their axes and pictures, and the way to a server."""
