// Colours of what compares maps, [red, green, blue]; those of the maps come from the server.

export const ONLY_FIRST = [0, 105, 175];
export const ONLY_SECOND = [240, 135, 0];
export const BOTH = [18, 22, 28];
export const PAPER = [255, 255, 255];

export const css = (rgb) => `rgb(${rgb.join(" ")})`;
