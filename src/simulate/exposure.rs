//! What a camera makes of colours: exposure and white balance of its own in every scan, and noise. Used by the survey.

use super::draw::Draw;

/// Standard deviation of the logarithm of a scan's exposure …
const EXPOSURE: f32 = 0.2;
/// … and of each channel's balance beside it.
const BALANCE: f32 = 0.06;
/// Standard deviation of the noise of a channel, of 255.
const NOISE: f32 = 8.0;

/// Turns the colours of surfaces into colours as one scan has them.
pub(super) fn expose(colors: &mut [[u8; 3]], draw: &mut Draw) {
    let exposure = EXPOSURE * draw.normal();
    let gain = [(); 3].map(|()| (exposure + BALANCE * draw.normal()).exp());
    for color in colors {
        for (channel, gain) in color.iter_mut().zip(gain) {
            *channel = (f32::from(*channel) * gain + NOISE * draw.normal()).round().clamp(0.0, 255.0) as u8;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::Seed;

    #[test]
    fn scans_differ_in_brightness_and_surfaces_keep_their_order() {
        let mut brightness = Vec::new();
        for subject in 0..20 {
            let mut draw = Draw::new(Seed(1).derive("test", subject));
            let mut colors: Vec<[u8; 3]> = [[60; 3], [150; 3]].into_iter().cycle().take(2000).collect();
            expose(&mut colors, &mut draw);
            let mean = |first| {
                colors.iter().skip(first).step_by(2).map(|color| f32::from(color[1])).sum::<f32>() / 1000.0
            };
            assert!(mean(0) < mean(1));
            brightness.push(mean(0));
        }
        let spread = brightness.iter().fold(0.0, |most, x| x.max(most))
            - brightness.iter().fold(255.0, |least, x| x.min(least));
        assert!(spread > 15.0, "{spread}");
    }
}
