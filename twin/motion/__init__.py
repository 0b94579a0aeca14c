"""Motion of the motors in closed form: velocity profiles, commands, braking."""
