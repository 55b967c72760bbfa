"""Objects from few rays: two rays, or one ray with a range, can show an object if they hardly meet by chance."""
