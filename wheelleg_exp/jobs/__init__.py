"""What the commands do: each job joins the parts (asset, env, rl, run, recording) into one piece of work.

| module | offers |
|---|---|
| ``train``, ``resume``, ``replay``, ``sweep`` | a training: begun, gone on with, repeated, several |
| ``play``, ``agents``, ``figures`` | rollouts of a policy, of zeros, of noise, and what they show in numbers |
| ``export`` | a policy as a deployer takes it |
| ``diff_inputs`` | what ``wheelleg diff`` compares |
| ``processes``, ``stop`` | a job in a process of its own, both ends of it, and Ctrl-C |
| ``threads`` | the thread policy of torch, and what a run records of it |
| ``display`` | what a job tells while it works |
| ``documents``, ``episode_recording`` | texts and episodes in a recording |
| ``kept_robot`` | the robot inside a run directory |
"""
