"""Drive a trained robot in real time: by hand in the browser, or with the commands of a YAML script."""
