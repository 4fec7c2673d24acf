// A .slider has a .stack of pictures, the first on the left of the line and the others on its right,
// and an input type=range for the line. Radio buttons, if there are any, choose among the others.
for (const slider of document.querySelectorAll(".slider")) {
  const stack = slider.querySelector(".stack");
  const range = slider.querySelector("input[type=range]");
  const move = () => stack.style.setProperty("--at", `${range.value}%`);
  range.addEventListener("input", move);
  const drag = (event) => {
    if (!event.buttons) return;
    const box = stack.getBoundingClientRect();
    range.value = (100 * (event.clientX - box.left)) / box.width;
    move();
  };
  stack.addEventListener("pointerdown", drag);
  stack.addEventListener("pointermove", drag);
  for (const image of stack.querySelectorAll("img")) image.draggable = false;
  const others = [...stack.querySelectorAll("img")].slice(1);
  const radios = [...slider.querySelectorAll("input[type=radio]")];
  const choose = () => others.forEach((image, i) => { image.hidden = !radios[i].checked; });
  for (const radio of radios) radio.addEventListener("change", choose);
  if (radios.length) choose();
  move();
}
