// What is typed into a field for a number stands in place of what it held: its text is selected
// when somebody comes to it.
"use strict";

const FIELD = 'input[type="number"], input.num';
/** @type {EventTarget | null} */
let entered = null;

document.addEventListener("focusin", ({ target }) => {
  entered = target;
});
document.addEventListener("keydown", () => {
  entered = null;
});
// A press puts the caret where the pointer is, after the field has got the focus.
document.addEventListener("click", ({ target }) => {
  if (target === entered && target instanceof HTMLInputElement && target.matches(FIELD))
    target.select();
  entered = null;
});
