"use strict";
const data = JSON.parse(document.getElementById("frames").textContent);
const find = (name) => document.getElementById(name);
const slider = find("light");
function show() {
  const frame = data.frames[slider.value];
  find("object").src = "data:image/jpeg;base64," + frame.image;
  find("ball").src = "data:image/jpeg;base64," + frame.ball;
  frame.probabilities.forEach((probability, index) => {
    const percent = Math.round(100 * probability) + "%";
    find("bar" + index).style.width = 100 * probability + "%";
    find("value" + index).textContent = percent;
  });
  const name = frame.predicted;
  const isRight = name === data.classes[0];
  find("predicted").textContent = (isRight ? "✓ " : "✗ ") + name;
  find("predicted").className = isRight ? "right" : "wrong";
  slider.setAttribute("aria-valuetext", name);
}
slider.addEventListener("input", show);
show();
