"""What the commands do: each job joins the parts (asset, env, rl, run, recording) into one piece of work."""
