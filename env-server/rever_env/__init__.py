"""The world of the four Bridge tasks.

tasks.toml -> tasks -> placement -> world (controller, success, camera, snapshot)
world -> expert -> reasoning -> demonstrations; world -> gymnasium_env; world -> server
"""
