// The clock: its slider, the button, and the keys.

/** A clock from 0 to `end` s; `show(time)` is called whenever its time changes. `step(time, direction)`: the next time. */
function makePlayback(show, step) {
  const [button, slider, speed] = ["play", "time", "speed"].map((id) => document.getElementById(id));
  let time = 0, end = 1, before = null;

  function go(next) {
    slider.value = time = Math.min(Math.max(next, 0), end);
    show(time);
  }

  function play(on) {
    before = on ? performance.now() : null;
    button.textContent = on ? "❚❚" : "▶";
    if (on && time >= end) go(0);
    if (on) requestAnimationFrame(frame);
  }

  function frame(now) {
    if (before === null) return;
    go(time + (now - before) / 1000 * Number(speed.value));
    before = now;
    if (time >= end) play(false); else requestAnimationFrame(frame);
  }

  button.addEventListener("click", () => play(before === null));
  slider.addEventListener("input", () => go(Number(slider.value)));
  document.addEventListener("keydown", (event) => {
    const steps = event.shiftKey ? 10 : 1, moves = {
      " ": () => play(before === null), Home: () => go(0), End: () => go(end),
      ArrowLeft: () => go(step(time, -steps)), ArrowRight: () => go(step(time, steps)),
    };
    if (!moves[event.key] || event.target.closest("select, button") || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    moves[event.key]();
  });

  return {
    go,
    now: () => time,
    load(length, first) {
      play(false);
      slider.max = end = length;
      go(first);
    },
  };
}
