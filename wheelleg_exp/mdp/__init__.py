"""The term library: what actions, commands, observations, events, rewards, terminations and curricula compute."""
