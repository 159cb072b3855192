"use strict";
// Resolve the page's CSS variables in a figure.
window.inPageColours = (figure) => {
  if (!figure) return window.dash_clientside.no_update;
  const colours = getComputedStyle(document.documentElement);
  return JSON.parse(JSON.stringify(figure).replace(/var\((--\w+)\)/g, (_, name) => colours.getPropertyValue(name).trim()));
};

// Whether each tab is hidden. Plots adapt to the size of their tab when it is shown.
window.shownTab = (chosen, names) => {
  setTimeout(() => window.dispatchEvent(new Event("resize")), 50);
  return names.map((name) => name !== chosen);
};

// Show when the server does not answer; Dash says so only in the console.
{
  const original = window.fetch;
  const mark = (lost) => document.documentElement.classList.toggle("lost", lost);
  window.fetch = async (...parameters) => {
    try {
      const response = await original(...parameters);
      mark(false);
      return response;
    } catch (error) {
      if (error.name !== "AbortError") mark(true);
      throw error;
    }
  };
}
