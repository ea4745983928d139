"use strict";
// Each recording has one frame. The slider, the video, the timeline and the charts follow it and set it.
for (const part of document.querySelectorAll(".recording")) {
  const first = Number(part.dataset.first), last = Number(part.dataset.last);
  const begin = Number(part.dataset.begin), end = Number(part.dataset.end);
  const slider = part.querySelector("input[type=range]"), output = part.querySelector("output");
  const views = [...part.querySelectorAll(".view")];
  const count = last - first + 1;
  let frame = first, view = views[0];
  part.classList.add("live");

  const video = () => view.querySelector("video");
  // The rate is constant: frame k is shown from k to k + 1 steps of duration / count.
  const step = (player) => player.duration / count;

  function show() {
    slider.value = frame;
    const seconds = count > 1 ? begin + (end - begin) * (frame - first) / (count - 1) : begin;
    const text = `frame ${frame}, ${seconds.toFixed(2)} s`;
    output.textContent = text;
    slider.setAttribute("aria-valuetext", text);
    for (const cursor of part.querySelectorAll(".bar .cursor")) {
      cursor.style.left = `${100 * (frame - first + 0.5) / count}%`;
    }
    for (const chart of part.querySelectorAll(".chart")) {
      const left = Number(chart.dataset.left), right = Number(chart.dataset.right);
      const x = left + (right - left) * (frame - first) / Math.max(last - first, 1);
      const cursor = chart.querySelector(".cursor");
      cursor.setAttribute("x1", x);
      cursor.setAttribute("x2", x);
    }
  }

  function seek(player) {
    if (player && Number.isFinite(player.duration)) player.currentTime = (frame - first + 0.5) * step(player);
  }

  function go(wanted) {
    frame = Math.min(Math.max(Math.round(wanted), first), last);
    if (video()) video().pause();
    seek(video());
    show();
  }

  const play = part.querySelector(".play");
  function showPlay() {
    play.hidden = !video();
    play.textContent = video() && !video().paused ? "Pause" : "Play";
  }
  play.addEventListener("click", () => {
    const player = video();
    if (!player.paused) return player.pause();
    if (frame === last) go(first);
    player.play();
  });

  function follow(player, time) {
    if (player !== video() || !Number.isFinite(player.duration)) return;
    frame = Math.min(first + Math.floor(time / step(player) + 0.01), last);
    show();
  }

  for (const player of part.querySelectorAll("video")) {
    player.controls = false; // they would cover the lower part of the picture
    player.addEventListener("play", showPlay);
    player.addEventListener("pause", () => { follow(player, player.currentTime); showPlay(); });
    player.addEventListener("click", () => play.click());
    player.addEventListener("loadedmetadata", () => { if (player === video()) seek(player); });
    if (player.requestVideoFrameCallback) {
      const each = (now, data) => {
        if (!player.paused) follow(player, data.mediaTime);
        player.requestVideoFrameCallback(each);
      };
      player.requestVideoFrameCallback(each);
    } else {
      player.addEventListener("timeupdate", () => follow(player, player.currentTime));
    }
  }
  slider.addEventListener("input", () => go(Number(slider.value)));
  for (const button of part.querySelectorAll(".step")) {
    button.addEventListener("click", () => go(frame + Number(button.dataset.by)));
  }
  for (const bar of part.querySelectorAll(".bar:not(.whole)")) {
    bar.addEventListener("click", (event) => {
      const box = bar.getBoundingClientRect();
      go(first + Math.floor(count * (event.clientX - box.left) / box.width));
    });
  }
  for (const chart of part.querySelectorAll(".chart")) {
    chart.addEventListener("click", (event) => {
      const box = chart.getBoundingClientRect(), width = chart.viewBox.baseVal.width;
      const left = Number(chart.dataset.left), right = Number(chart.dataset.right);
      go(first + (last - first) * ((event.clientX - box.left) * width / box.width - left) / (right - left));
    });
  }

  function choose(tracer) {
    if (video()) video().pause();
    view = views.find((one) => one.dataset.tracer === tracer) || views[0];
    for (const one of views) one.classList.toggle("hidden", one !== view);
    seek(video());
    show();
    showPlay();
  }
  for (const radio of part.querySelectorAll("input[type=radio]")) {
    radio.addEventListener("change", () => choose(radio.value));
  }
  part.addEventListener("goto", (event) => { part.open = true; go(event.detail); slider.focus(); part.scrollIntoView(); });
  choose(views[0].dataset.tracer);
}

for (const button of document.querySelectorAll(".go")) {
  const part = [...document.querySelectorAll(".recording")].find((one) => one.dataset.recording === button.dataset.recording);
  if (part) {
    button.addEventListener("click", () => part.dispatchEvent(new CustomEvent("goto", { detail: Number(button.dataset.frame) })));
  } else {
    button.remove();
  }
}
