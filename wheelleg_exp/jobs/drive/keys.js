// Send keys and gamepads of the drive page to the program, over a websocket of their own.
// The program prepends DRIVE: {url, keys: {code: [axis, share]}, presses: {code: name}, sticks, buttons}.
(() => {
  if (window.wheellegDrive) window.wheellegDrive.close();
  const socket = new WebSocket(DRIVE.url);
  const held = new Set();    // codes of the keys that are down
  let sticks = {}, pressed = new Set(), sent = {}, timer = 0;

  const send = (message) => socket.readyState === WebSocket.OPEN && socket.send(JSON.stringify(message));

  function steer() {
    const shares = {};
    for (const [axis, share] of Object.values(DRIVE.keys)) shares[axis] = 0;
    for (const code of held) { const [axis, share] = DRIVE.keys[code]; shares[axis] += share; }
    for (const [axis, share] of Object.entries(sticks)) if (share) shares[axis] = share;
    for (const [axis, share] of Object.entries(shares)) {
      const value = Math.max(-1, Math.min(1, share));
      if ((sent[axis] || 0) !== value) { sent[axis] = value; send({steer: axis, share: value}); }
    }
  }

  function onKey(event) {
    const typing = event.target.closest && event.target.closest('input[type=text], textarea, [contenteditable=true]');
    if (typing || event.ctrlKey || event.altKey || event.metaKey) return;
    const down = event.type === 'keydown';
    if (event.code in DRIVE.keys) {
      if (down) held.add(event.code); else held.delete(event.code);
      steer();
    } else if (event.code in DRIVE.presses) {
      if (down && !event.repeat) send({press: DRIVE.presses[event.code]});
    } else return;
    event.preventDefault();
    event.stopImmediatePropagation();  // the camera of the page uses the same keys
  }

  function onBlur() { held.clear(); steer(); }

  function poll() {
    const pad = [...navigator.getGamepads()].find((p) => p && p.connected);
    sticks = {};
    for (const [index, [axis, sign]] of Object.entries(DRIVE.sticks)) {
      const value = pad ? pad.axes[index] || 0 : 0;
      if (Math.abs(value) > DRIVE.deadzone) sticks[axis] = sign * value;
    }
    const down = new Set(Object.keys(DRIVE.buttons).filter((i) => pad && pad.buttons[i] && pad.buttons[i].pressed));
    for (const index of down) if (!pressed.has(index)) send({press: DRIVE.buttons[index]});
    pressed = down;
    steer();
  }

  document.title = DRIVE.title;
  const help = Object.assign(document.createElement('div'), {id: 'drive-keys', innerHTML: DRIVE.help + `<style>
    #drive-keys { position: fixed; left: 12px; top: 12px; max-width: calc(100vw - 372px); display: flex; flex-wrap: wrap;
      gap: 4px 14px; padding: 8px 12px; border-radius: 8px; background: #fffc; font: 13px sans-serif; pointer-events: none; }
    #drive-keys kbd { padding: 1px 5px; border: 1px solid #889; border-radius: 4px; background: #fff; font: inherit; }
  </style>`});
  document.body.append(help);

  const options = {capture: true};
  window.addEventListener('keydown', onKey, options);
  window.addEventListener('keyup', onKey, options);
  window.addEventListener('blur', onBlur);
  socket.onopen = () => { sent = {}; timer = setInterval(poll, 33); };
  window.wheellegDrive = {
    socket,
    close() {
      help.remove();
      clearInterval(timer);
      window.removeEventListener('keydown', onKey, options);
      window.removeEventListener('keyup', onKey, options);
      window.removeEventListener('blur', onBlur);
      socket.close();
    },
  };
})();
