"use strict";
// A figure with the values of the page's CSS variables in place of their names.
window.inPageColours = (figure) => {
  if (!figure) return window.dash_clientside.no_update;
  const colours = getComputedStyle(document.documentElement);
  return JSON.parse(JSON.stringify(figure).replace(/var\((--\w+)\)/g, (_, name) => colours.getPropertyValue(name).trim()));
};

// Which of the tabs are hidden; plots take the size of theirs when it is shown.
window.shownTab = (chosen, names) => {
  setTimeout(() => window.dispatchEvent(new Event("resize")), 50);
  return names.map((name) => name !== chosen);
};
