// The clock: its slider, the button, and the keys.

/** A clock from 0 to `end` s; `show(time)` is called whenever its time changes. `step(time, direction)`: the next time. */
function makePlayback(show, step) {
  const [button, slider, speed] = ["play", "time", "speed"].map((id) => document.getElementById(id));
  let time = 0, begin = 0, end = 1, before = null;

  function go(next) {
    time = Math.min(Math.max(next, begin), end);
    slider.value = time;
    show(time);
  }

  function frame(now) {
    if (before === null) return;
    go(time + (now - before) / 1000 * Number(speed.value));
    before = now;
    if (time >= end) stop(); else requestAnimationFrame(frame);
  }

  function stop() {
    before = null;
    button.textContent = "▶";
  }

  function toggle() {
    if (before !== null) return stop();
    if (time >= end) go(begin);
    button.textContent = "❚❚";
    before = performance.now();
    requestAnimationFrame(frame);
  }

  button.addEventListener("click", toggle);
  slider.addEventListener("input", () => go(Number(slider.value)));
  document.addEventListener("keydown", (event) => {
    if (event.target.closest("select, button, summary") && event.key !== "Home" && event.key !== "End") return;
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const moves = {
      " ": toggle, Home: () => go(begin), End: () => go(end),
      ArrowLeft: () => go(step(time, event.shiftKey ? -10 : -1)), ArrowRight: () => go(step(time, event.shiftKey ? 10 : 1)),
    };
    if (moves[event.key]) {
      event.preventDefault();
      moves[event.key]();
    }
  });

  return {
    go,
    now: () => time,
    /** Keeps the clock between two times of the recording. */
    limit(from, to) {
      [begin, end] = [Math.max(from, 0), Math.min(to, Number(slider.max))];
      go(time);
    },
    load(length, first) {
      stop();
      [begin, end] = [0, length];
      slider.max = end;
      go(first);
    },
  };
}
