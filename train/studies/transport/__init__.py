"""What shadows and bounces cost, and how right they are: beside direct light, beside more rays, and beside Mitsuba."""
